"""Reduced models of tissue at finite strain: sampled cells with weights, one discrete gradient, a compiled stepper."""

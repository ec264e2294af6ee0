"""Simulate a rigid robot hand that holds soft tissue, reduce the model, and control it optimally."""

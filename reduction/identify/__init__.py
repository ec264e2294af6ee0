"""The material of a scene from measured outputs, with an error that has parts: noise, mesh, time step, reduction."""

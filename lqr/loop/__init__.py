"""The closed loop: sampling, delay, limits, cost, controllers."""

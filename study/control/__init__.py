"""`softgrasp control`: feedback, reduced gains, closed loop."""

"""`softgrasp hardcases`: stay stable or refuse with a reason."""

"""`softgrasp simulate` and `softgrasp explain`."""

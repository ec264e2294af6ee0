"""`softgrasp reduce`: bases, errors against N and time."""

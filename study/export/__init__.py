"""``softgrasp export``: reduced models for other programs."""

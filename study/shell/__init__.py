"""What stands between a terminal and a command."""

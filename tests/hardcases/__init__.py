"""`python -m tests.hardcases`: runs that stay within a bound, or are refused with a reason."""

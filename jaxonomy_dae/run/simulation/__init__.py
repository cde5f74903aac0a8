"""`simulate` and what it returns."""

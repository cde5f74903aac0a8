"""What is said when something does not fit."""

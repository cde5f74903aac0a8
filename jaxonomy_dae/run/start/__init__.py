"""Consistent initialization."""

"""Reverse-mode differentiation of a solve."""

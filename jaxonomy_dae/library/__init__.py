"""Components by physical domain."""

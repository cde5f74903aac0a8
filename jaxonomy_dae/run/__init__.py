"""A system at a point, its start, its trajectory."""

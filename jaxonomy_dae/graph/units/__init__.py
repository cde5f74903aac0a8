"""Units of measurement: what a text such as 'kg/(m*s)' means, and whether they fit together in an expression."""

"""Expressions and integers: what equations say, how they hang together, and what can be judged of their matrices."""

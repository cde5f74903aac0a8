"""Expressions as shared graphs, read from SymPy, differentiated and evaluated in time linear in their size."""

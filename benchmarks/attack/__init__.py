"""Random models against independent solutions.

Every family (`resistors.py`, `circuits.py`, …) makes random models from a seed and solves each of them a second time,
in NumPy and SciPy only, from the physics rather than from the package's equations. `judge.py` compares; `__main__.py`
counts: `python -m benchmarks.attack --family resistors --count 100`, or, for so many minutes and all families in turn,
`make attack MINUTES=10`.
"""

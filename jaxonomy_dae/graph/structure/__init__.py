"""Integers and graphs: incidence, matching, Pantelides, tearing."""

"""Compiled programs: which are kept, and what room the machine has for them."""

"""What every room stands on: errors, tolerances, types by their meaning, names that other libraries do not publish."""

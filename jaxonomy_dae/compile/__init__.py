"""From a diagram to a plan: the flat model, the passes, the lowering."""

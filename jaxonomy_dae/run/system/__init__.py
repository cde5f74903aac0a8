"""The compiled model: parameters, evaluation at a point, report."""

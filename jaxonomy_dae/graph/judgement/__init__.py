"""What numbers say about matrices whose entries are known to within an error: scales, ranks, conditions."""

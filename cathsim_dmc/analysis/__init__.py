"""What recorded episodes say: force statistics, success rates, heatmaps."""

"""Force statistics, success rates and heatmaps of episodes."""

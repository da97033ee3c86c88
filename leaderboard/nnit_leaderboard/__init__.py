"""The leaderboard: reads the result files that nnit-bench writes, and nothing else."""

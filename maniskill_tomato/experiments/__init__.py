"""Episodes of policies, their statistics, reports and films."""

"""Episodes to metrics, plots and reports."""

"""Where results go: pictures, plots and tables."""

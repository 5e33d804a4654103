"""What `fitting` offers: logs in, results out."""

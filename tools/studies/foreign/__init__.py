"""`diagnose` on foreign grounds: reality comes from elsewhere, and nothing in it is exactly as the model says."""

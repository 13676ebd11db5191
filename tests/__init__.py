"""Import packages are the top-level folders; tests run against the checkout."""

"""What reproduces a page of results; no command imports it."""

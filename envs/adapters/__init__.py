"""Tasks in the form that other libraries expect."""

"""How commands run: start, follow, evaluate, checkpoint, resume, record, report."""

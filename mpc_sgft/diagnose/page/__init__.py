"""report.html: what an engineer would put before a colleague."""

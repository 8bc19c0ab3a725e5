"""Front ends: scan-to-scan motion from scans alone."""

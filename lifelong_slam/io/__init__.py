"""Writers and readers of the standard files that a run leaves behind."""

"""Loop closures: candidates by place and by appearance, then verification by registration."""

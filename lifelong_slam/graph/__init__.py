"""The pose graph: vertices, edges, robust optimisation."""

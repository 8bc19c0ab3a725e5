"""One self-contained HTML file for a run or a comparison: open it without a network, print it, send it."""

"""Where scans come from: bags, folders, data sets, the simulator."""

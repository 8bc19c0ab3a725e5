"""The SLAM systems that a run can choose from: our own, and the peers it is compared with."""

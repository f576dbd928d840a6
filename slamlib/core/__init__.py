"""What the chapters derive: motions, odometry, markers, and the factor graph in GTSAM."""

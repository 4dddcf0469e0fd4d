"""What a robot logged of its end effector: CSV, MCAP, or an episode of a LeRobot data set."""

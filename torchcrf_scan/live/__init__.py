"""Scans of a running robot over DDS, as ROS 2 sends them, and answers to them; without an installation of ROS."""

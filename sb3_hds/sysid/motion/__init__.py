"""Motion of joints in recordings: positions, velocities, accelerations, and their noise."""

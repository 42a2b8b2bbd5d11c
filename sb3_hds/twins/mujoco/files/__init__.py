"""Model files of robots: read, refused where a twin would be wrong, and written back corrected."""

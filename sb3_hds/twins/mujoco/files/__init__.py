"""Model files of robots: loading, unsupported features, and corrected copies."""

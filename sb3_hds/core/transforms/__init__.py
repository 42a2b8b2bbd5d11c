"""What a wrapper does to actions and observations, for an environment and for its twin alike."""

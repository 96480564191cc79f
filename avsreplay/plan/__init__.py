"""Rendezvous with a moving grasp point in least time."""

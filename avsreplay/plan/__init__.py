"""Time-optimal rendezvous with the grasp point under constraints, and the supervisor."""

"""What a compressed scene lost: errors of its stored values, and the same for other tools."""

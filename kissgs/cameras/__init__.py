"""From where a scene is looked at: posed photographs, and virtual cameras for a scene that has none."""

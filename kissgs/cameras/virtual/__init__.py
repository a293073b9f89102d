"""Virtual cameras: cameras placed by kissgs, for a scene without a capture or beside one."""

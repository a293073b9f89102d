"""The preview page of one scene: a scene of any format goes in; a local server, or one HTML file, comes out."""

"""Measurements of presets, parts of the codec and external codecs: takes scenes, returns results and plots."""

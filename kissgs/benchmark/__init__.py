"""Measurements of the codec and of other tools on scenes of the user. Takes scenes; gives results, tables and plots."""

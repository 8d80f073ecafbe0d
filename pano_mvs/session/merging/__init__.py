"""Merge the output folders of blocks of a capture into one."""

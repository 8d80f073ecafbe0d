"""Workflow files: read, merged, validated and wired into a graph of stages."""

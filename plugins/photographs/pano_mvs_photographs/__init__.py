"""Ordinary photographs among the panoramas: their cameras, and their colours for the cloud."""

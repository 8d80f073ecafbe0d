"""Errors, digests and other things that every layer may use and that know nothing of panoramas."""

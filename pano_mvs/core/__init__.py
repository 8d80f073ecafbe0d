"""Errors, digests, files and other basics that every layer may use and that do not concern panoramas."""

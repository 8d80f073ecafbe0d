"""Tests of the documentation: its commands, examples, facts and language."""

"""Records of a run for others: spans of OpenTelemetry, a message when it has ended, and its description as RO-Crate."""

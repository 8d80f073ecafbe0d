"""The sphere sweep: range by testing virtual depths."""

"""The matching costs: one module for each, and the registry to which plugins add theirs."""

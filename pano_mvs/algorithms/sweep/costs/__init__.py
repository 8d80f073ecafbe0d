"""The matching costs: one module for each built-in one, and the registry, to which plugins add theirs.

A new built-in cost is a module here with a `SweepCost`, and an entry in `registry.BUILTIN`; the backends numpy and
opencv have it at once. To be compiled, it also needs a number in `kernels_constants` and a branch in
`pixel_cost_row`.
"""

"""Faults that change nothing that the code promises, by their id, with the reason."""

EQUIVALENT = {
    # geometry
    "091d37af": "similarity_from_points: the target is centred, so a shift of the source leaves the covariance",
    # keys
    "028cd36f": "canonical_text: any text will do that is equal for equal trees alone; this one is, with X between",
    "01390d36": "_write: likewise, with X after a list",
    "0c56e3aa": "_write: likewise, as a comma follows each item of a list",
    "05b3ca1c": "CodeGraph._definition_node: the digest is set before the node is returned",
    # scheduler
    "0a2a90b3": "Scheduler._hand_out: nobody reads the status of a unit that is refused",
    # scene
    "0add1aad": "_SIZES: fields of type 6 have one byte, as fields of unknown types have",
}

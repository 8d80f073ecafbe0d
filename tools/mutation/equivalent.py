"""Faults that change nothing that the code promises, by their id, with the reason."""

EQUIVALENT = {
    # geometry
    "091d37af": "similarity_from_points: the target is centred, so a shift of the source leaves the covariance",
    # keys
    "028cd36f": "canonical_text: any text will do that is equal for equal trees alone; this one is, with X between",
    "01390d36": "_write: likewise, with X after a list",
    "0c56e3aa": "_write: likewise, as a comma follows each item of a list",
    "0625d3c6": "Resolver._input: a unit that cannot run does not wait, whatever is said of its waiting",
    # wiring
    "262a5645": "wiring_problems: the name of the workflow is not read",
    "699b16f0": "_Wirer.connect: of several names that are close only the first is shown",
    # run_pass
    "46a1225a": "RunPass._publish: nobody reads the status of a unit whose files cannot be delivered",
    "45236129": "RunPass._publish: the damaged blob is gone, so that its record is not found either",
    "ecfbff9e": "RunPass._dispatch: nobody reads the status of a unit that is refused",
    # scene
    "1005f29f": "JPEG_FRAMES: the marker D0 has no length, and is never asked after",
    "a7dd3345": "_heif_size: the fifth to eighth bytes are another box's, so that none begins at 0",
    "0add1aad": "_SIZES: fields of type 6 have one byte, as fields of unknown types have",
}

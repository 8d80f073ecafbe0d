"""`python -m pano_mvs` is `pano-mvs`."""

from pano_mvs.cli.app import main

if __name__ == "__main__":
    main()

"""Files of floor plans: world files, SVG and DXF."""

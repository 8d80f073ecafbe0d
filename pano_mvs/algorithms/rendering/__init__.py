"""Images of clouds, rendered with numpy."""

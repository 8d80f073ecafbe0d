"""Pictures of clouds, drawn with numpy alone."""

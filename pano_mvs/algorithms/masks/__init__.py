"""What of a picture is to be ignored, found in the picture itself."""

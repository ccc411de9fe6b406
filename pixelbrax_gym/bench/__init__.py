"""``pixelbrax bench``: how fast PixelBrax is on the user's machine."""

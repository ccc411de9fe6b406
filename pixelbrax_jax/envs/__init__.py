"""Physics, scene and renderer put together: one environment, and batches of them."""

"""From trained weights to predictions: disparities of image files, what `dualdepth predict` reads and writes, and ONNX files."""

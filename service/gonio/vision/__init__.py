"""Pixels in: video, ONNX models, person tracking. The only place of cv2, av and onnxruntime."""

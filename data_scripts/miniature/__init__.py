"""The embedded synthetic street world: streets, solids, ray casting, colours, and KITTI's file formats."""

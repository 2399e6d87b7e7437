"""Shards: tar files of raw linear values in the webdataset convention, with an index.

    SHARDS/index.json          what there is; written last, so a folder without it is not finished
    SHARDS/train-00000.tar     training patches, or clips: the same patch of consecutive frames
    SHARDS/validation-00000.tar
    SHARDS/test-00000.tar      whole frames

A sample is two members, `KEY.json` (scene, frame, place, exposure, and name, type, shape and offset of each
buffer) and `KEY.buffers` (little-endian arrays (C, H, W) one after another). A clip of N frames has arrays
(N, C, H, W), says `frames` N, and has a `depth_range` for each frame; `frame` and `exposure` are those of the
first. The webdataset library reads them as they are; `data.shards.read` maps the files into memory and goes
straight to a sample by the index.
"""

"""What the stage has to know of Newton and Warp beyond their public interfaces."""

"""What this package uses of Warp and Newton beyond their public interfaces: one function for each name or contract.

Each function says which contract it relies on, and what happens in a version that breaks it: a clear error that names
it, or a fallback that says so in a warning. A version that was not tested warns at first use, once a package.

What the versions of Newton differ in is here as well, also where it is public: each function says what the older ones
lack. What those of Warp differ in is in :mod:`warp_bsc.kernels.not_inlined`, as the kernels import nothing from here.
"""

"""The data of a step: structs, motion, mesh, friction, planes and poses."""

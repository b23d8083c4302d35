"""The data of a step: structs, motion, mesh, friction, planes, poses and the record for the adjoint."""

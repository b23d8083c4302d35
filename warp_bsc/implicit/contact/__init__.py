"""The solver with contact inside: one Newton solve of inertia, elasticity, barriers and friction for each step."""

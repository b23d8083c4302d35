"""The solver with contact inside, and gradients through its steps. Guides: docs/newton/implicit.md, gradients.md."""

"""Full-order model of a rigid hand that holds soft tissue: scene, mesh, blocks, midpoint run."""

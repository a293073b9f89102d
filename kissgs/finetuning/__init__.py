"""Fine-tuning: an encoding plan and training targets -> a plan of equal layout with better levels. The levels are
trained through a differentiable decoder, with loss terms for the size of the container."""

"""What is found out about simulations: measures, accuracy, hard cases, validation, experiments; and how it is kept."""

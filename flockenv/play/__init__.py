"""The playground: one or several worlds of one seed that people watch and change while they run."""

"""Planning with a world model: goals (``goals``), search by MPPI (``mppi``), the check in the twin (``execute``)."""

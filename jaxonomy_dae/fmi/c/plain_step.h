
/* Runs to a time, by Rodas5P with error control, through all events; after `terminate` it has stopped earlier. */
int plant_run(plant *m, double until, int *terminate);

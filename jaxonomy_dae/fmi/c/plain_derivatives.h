
/* The derivative of (field, outputs, guards) along a direction, an array like `s.d`; and the derivative of their weighted sum by each number
   of `s.d`: time, states, inputs, parameters and networks' weights; zero for others. */
void plant_get_forward(plant *m, const double *along, double *derivatives);
void plant_get_reverse(plant *m, const double *weights, double *derivatives);

/* tape.h: the reference forward pass in float64, which keeps the values that the backward pass
 * needs (the tape), and the backward pass.
 *
 * The gradient of the parameters is computed for several passes at once (mo_controller_accumulate),
 * so that each row of the gradient is fetched from memory once for all passes. */
#ifndef MORPHO_CONTROLLER_TAPE_H
#define MORPHO_CONTROLLER_TAPE_H

#include <morpho/controller.h>

/* One pass over n springs. All arrays are in the caller's memory; see mo_controller_tape_place. */
struct mo_controller_tape {
  double *input;  /* (n_inputs) set by the caller */
  double *normal; /* (MO_HIDDEN_LAYERS, MO_HIDDEN) LayerNorm before gain and shift */
  double *scale;  /* (MO_HIDDEN_LAYERS) 1 / sqrt(variance + ε) */
  double *hidden; /* (MO_HIDDEN_LAYERS, MO_HIDDEN) outputs of the ReLUs */
  double *output; /* (n) after tanh */
  double *d_dense; /* (MO_HIDDEN_LAYERS, MO_HIDDEN) ∂loss/∂ outputs of the matrices; written by the
                      backward pass */
  double *d_shifted; /* (MO_HIDDEN_LAYERS, MO_HIDDEN) ∂loss/∂ inputs of the ReLUs; written by the
                        backward pass */
  double *d_last;    /* (n) ∂loss/∂ inputs of tanh; written by the backward pass */
};

/* Return the number of doubles that the arrays of one tape need, and place a tape in them. */
size_t mo_controller_tape_doubles(const struct mo_controller *controller, uint32_t n);
struct mo_controller_tape mo_controller_tape_place(const struct mo_controller *controller,
                                                   uint32_t n, double *memory);

/* Computes the forward pass from tape->input to tape->output for the n springs listed in `springs`
 * (NULL: the first n): output[i] is the activation of springs[i]. Fills in the rest of the tape,
 * except d_*. */
void mo_controller_forward(const struct mo_controller *controller, const uint32_t *springs,
                           uint32_t n, struct mo_controller_tape *tape);

/* Adds ∂loss/∂inputs to d_inputs (n_inputs), given d_outputs (n) = ∂loss/∂outputs of the pass on
 * the tape. */
void mo_controller_backward(const struct mo_controller *controller, const uint32_t *springs,
                            uint32_t n, const double *d_outputs, struct mo_controller_tape *tape,
                            double *d_inputs);

/* Adds ∂loss/∂parameters, summed over the tapes in their order, to d_parameters (n_parameters, file
 * order). Each tape must have been through mo_controller_backward with the same springs.
 */
void mo_controller_accumulate(const struct mo_controller *controller, const uint32_t *springs,
                              uint32_t n, const struct mo_controller_tape *tapes, uint32_t n_tapes,
                              double *d_parameters);

#endif

#include "plant.h"

void sg_plant_start(sg_plant *plant) {
    sg_controller_start(&plant->controller);
    for (int i = 0; i < SG_PLANT_OUTPUTS; ++i) plant->u[i] = 0;
    plant->w[0] = plant->theta[0] = 0;
}

int sg_plant_material(sg_plant *plant, const double theta[SG_PLANT_THETA]) {
    plant->theta[0] = theta[0];
    return SG_PLANT_OK;
}

int sg_plant_tick(sg_plant *plant, const double seen[SG_PLANT_INPUTS]) {
    const double *v = seen + SG_CONTROLLER_INPUTS;
    const double *y = SG_CONTROLLER_OTHERS ? seen + 2 * SG_CONTROLLER_INPUTS : 0;
    int status = sg_controller_tick(&plant->controller, seen, v, y, plant->u);
    return status == SG_CONTROLLER_NO_HAND ? SG_PLANT_NO_HAND : SG_PLANT_OK;
}

void sg_plant_outputs(const sg_plant *plant, double u[SG_PLANT_OUTPUTS]) {
    for (int i = 0; i < SG_PLANT_OUTPUTS; ++i) u[i] = plant->u[i];
}

int sg_plant_rate(const sg_plant *plant, const double seen[SG_PLANT_INPUTS], double rate[SG_PLANT_N]) {
    (void)plant, (void)seen;
    rate[0] = 0;
    return SG_PLANT_OK;
}

const char *sg_plant_message(int status) {
    return sg_controller_message(status == SG_PLANT_OK ? SG_CONTROLLER_OK : SG_CONTROLLER_NO_HAND);
}

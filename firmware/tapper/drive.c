#include "drive.h"

void drive_start(struct drive *d)
{
    *d = (struct drive){.phase = DRIVE_OFF};
}

void drive_halt(struct drive *d)
{
    d->phase = DRIVE_OFF;
    d->step_high = false;
}

/* Leave a closed switch before seeking it, which proves that switch and motor work. */
static void leave_switch(struct drive *d, int16_t at_most)
{
    d->steps_left = at_most;
    d->phase = DRIVE_LEAVING;
}

void drive_home(struct drive *d)
{
    if (d->phase == DRIVE_OFF)
        d->wait = DRIVE_WAKE_TICKS;
    leave_switch(d, DRIVE_LEAVE_STEPS);
}

void drive_out(struct drive *d, int16_t steps)
{
    if (d->phase != DRIVE_HOLDING)
        return;
    d->target = steps;
    d->opened = false;
    d->phase = DRIVE_OUT;
}

void drive_back(struct drive *d)
{
    if (d->phase == DRIVE_LEAVING || d->phase == DRIVE_SEEKING)
        drive_halt(d);
    else if (d->phase == DRIVE_OFF || (d->phase == DRIVE_HOLDING && d->place == 0))
        return;
    else if (d->opened)
        d->phase = DRIVE_BACK;
    else
        /* The switch has not confirmed this short motion, so steps may be missing: find its edge. A
         * switch that is stuck must not let a stopped carriage go far. */
        leave_switch(d, 2 * FRONT_HYSTERESIS_STEPS);
}

enum drive_status drive_status(const struct drive *d)
{
    if (d->phase == DRIVE_OFF)
        return DRIVE_UNKNOWN;
    return d->phase == DRIVE_HOLDING ? DRIVE_THERE : DRIVE_MOVING;
}

/* Take a sample of the switch; return whether its level is stable. */
static bool settled(struct drive *d, bool front_closed)
{
    if (front_closed != d->closed)
        d->equal = 0;
    d->closed = front_closed;
    if (d->equal < DRIVE_SETTLE_TICKS)
        d->equal++;
    return d->equal == DRIVE_SETTLE_TICKS;
}

/* Switch the motor off if the carriage is not at the switch, where it should be, for example because
 * somebody has turned the screw. A shot from there would have more energy than requested. */
static bool moved_away(struct drive *d)
{
    if (d->place != 0 || d->closed)
        return false;
    drive_halt(d);
    return true;
}

/* Return the direction of the next step: +1 outward, -1 to the front, 0 for no step. */
static int8_t next_step(struct drive *d)
{
    switch (d->phase) {
    case DRIVE_LEAVING:
        if (!d->closed) {
            d->phase = DRIVE_SEEKING;
            d->steps_left = LONGEST_DRAW_STEPS + DRIVE_LEAVE_STEPS;
            return 0;
        }
        if (d->steps_left-- > 0)
            return 1;
        drive_halt(d); /* the switch is stuck, or the motor does not move */
        return 0;
    case DRIVE_SEEKING:
        if (d->closed) {
            d->place = d->target = 0;
            d->phase = DRIVE_HOLDING;
            return 0;
        }
        if (d->steps_left-- > 0)
            return -1;
        drive_halt(d);
        return 0;
    case DRIVE_OUT:
        if (moved_away(d))
            return 0;
        d->opened |= !d->closed;
        if (d->closed && d->place >= FRONT_HYSTERESIS_STEPS) {
            drive_halt(d); /* the steps did not move the carriage */
            return 0;
        }
        if (d->place < d->target) {
            d->place++;
            return 1;
        }
        d->phase = DRIVE_HOLDING;
        return 0;
    case DRIVE_BACK:
        if (d->closed && d->place <= FRONT_SLACK_STEPS) {
            d->place = d->target = 0;
            d->phase = DRIVE_HOLDING;
            return 0;
        }
        /* Closed too early: steps were missed on the way out. Still open: steps were missed on the
         * way back. */
        if (d->closed || d->place <= -FRONT_SLACK_STEPS) {
            drive_halt(d);
            return 0;
        }
        d->place--;
        return -1;
    case DRIVE_HOLDING:
        moved_away(d);
        return 0;
    default:
        return 0;
    }
}

uint8_t drive_tick(struct drive *d, bool front_closed)
{
    uint8_t outputs = DRIVE_ENABLE;
    bool certain = settled(d, front_closed);

    if (d->phase == DRIVE_OFF)
        return 0;
    if (d->wait) {
        d->wait--;
        return outputs;
    }
    if (d->step_high) {
        d->step_high = false;
        return outputs;
    }
    /* No step is made while the switch bounces, so its position of closing and opening is exact. */
    int8_t direction = certain ? next_step(d) : 0;
    if (d->phase == DRIVE_OFF)
        return 0;
    if (direction > 0)
        outputs |= DRIVE_OUTWARD;
    if (direction) {
        outputs |= DRIVE_STEP;
        d->step_high = true;
    }
    return outputs;
}

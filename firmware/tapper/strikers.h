/* Monitoring of strikers at fixed mounts by the switch at each mount, independent of the hardware.
 *
 * A switch is closed while its striker is at its mount. After a start, no position is proven, and
 * HOME checks that every switch is closed. After a release, the switch must open and close again.
 * Otherwise the striker is blocked or the switch is stuck, and nothing is charged before the next
 * HOME.
 */
#ifndef STRIKERS_H
#define STRIKERS_H

#include <stdbool.h>
#include <stdint.h>

#include "drive.h"

#ifndef STRIKER_LEAVE_MS
#define STRIKER_LEAVE_MS 200u   /* longest time from the release to an open switch */
#endif
#ifndef STRIKER_RETURN_MS
#define STRIKER_RETURN_MS 4000u /* longest time from the release to a closed switch */
#endif
#define STRIKER_SETTLE_MS 3u    /* equal samples after which a level is valid */

enum strikers_phase { STRIKERS_LOST, STRIKERS_AT_MOUNTS, STRIKERS_LEAVING, STRIKERS_AWAY };

struct strikers {
    enum strikers_phase phase;
    uint8_t fitted;   /* mask of the channels that exist */
    uint8_t home;     /* mask of the closed switches, debounced */
    uint8_t sample;
    uint8_t equal;    /* number of consecutive equal samples, at most STRIKER_SETTLE_MS */
    uint8_t channel;  /* channel released last */
    uint16_t passed;  /* ms since the release */
};

void strikers_start(struct strikers *s, uint8_t count);
void strikers_prove(struct strikers *s);                    /* HOME: check all switches */
void strikers_released(struct strikers *s, uint8_t channel);
/* Call every millisecond with the levels of the switches, one bit per channel. */
void strikers_tick(struct strikers *s, uint8_t closed);
enum drive_status strikers_status(const struct strikers *s);

#endif

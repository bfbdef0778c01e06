/* A board in memory for tests on the host: the functions that tapper.h asks for, the spring's carriage,
 * and handles to turn. Its time is the tests'; every millisecond it does what the real board does. */
#include <math.h>
#include <string.h>

#include "carriage.h"
#include "tapper.h"

#define PULSE_MS 20u
#define STEPS_PER_ROOT_MJ 400.0 /* 500 N/m, 5 um a step */

static struct tapper tapper;
static struct drive drive;
static struct carriage carriage;
static bool interlock, enabling, wire_open, button, stop_wins;
static uint32_t clock_ms, pulse_until, boot_number;
static uint32_t releases;
static double released_from;
static bool pulsing;
static uint64_t kept;
static char output[1 << 14];
static size_t written;

bool board_interlock_closed(void) { return interlock; }
bool board_enabled(void) { return enabling; }
static long steps_for(uint32_t energy_uj)
{
    return lround(STEPS_PER_ROOT_MJ * sqrt(energy_uj * 1e-3));
}
bool board_can_store(uint32_t energy_uj)
{
    long steps = steps_for(energy_uj);
    double stored = 1e3 * (steps / STEPS_PER_ROOT_MJ) * (steps / STEPS_PER_ROOT_MJ);
    return steps > 0 && steps <= LONGEST_DRAW_STEPS && fabs(stored - energy_uj) <= 0.03 * energy_uj;
}
void board_home(void) { drive_home(&drive); }
void board_charge(uint32_t energy_uj) { drive_out(&drive, (int16_t)steps_for(energy_uj)); }
void board_discharge(void)
{
    pulsing = false;
    drive_back(&drive);
}
void board_halt(void)
{
    pulsing = false;
    drive_halt(&drive);
}
enum drive_status board_drive(void) { return drive_status(&drive); }
enum tapper_release board_release(uint32_t deadline)
{
    if (!tapper_in_window(deadline, clock_ms))
        return RELEASE_LATE;
    if (stop_wins)
        return RELEASE_STOPPED;
    releases++;
    released_from = carriage.place;
    pulsing = true;
    pulse_until = clock_ms + PULSE_MS;
    return RELEASE_BEGUN;
}
bool board_releasing(void) { return pulsing; }
void board_keep_used(uint64_t shot) { kept = shot; }
uint32_t board_forget_used(void)
{
    kept = 0;
    return ++boot_number;
}
void board_send(const char *text)
{
    size_t length = strlen(text);
    if (written + length < sizeof output) {
        memcpy(output + written, text, length + 1);
        written += length;
    }
}

static void millisecond(void)
{
    clock_ms++;
    for (int tick = 0; tick < 8; tick++) {
        uint8_t outputs = drive_tick(&drive, carriage_at_front(&carriage));
        carriage.enabled = outputs & DRIVE_ENABLE;
        if (outputs & DRIVE_STEP)
            carriage_step(&carriage, outputs & DRIVE_OUTWARD);
        carriage_wait(&carriage, 125);
    }
    if (pulsing && clock_ms == pulse_until)
        pulsing = false;
    if (wire_open)
        tapper_stop(&tapper, true);
    tapper_button(&tapper, button, clock_ms);
    tapper_poll(&tapper, clock_ms);
}

/* Lets the board run until `now`. */
void host_run(uint32_t now)
{
    while (clock_ms != now)
        millisecond();
}
void host_step(void) { millisecond(); }
/* The board is switched on, with its carriage wherever it stands. */
void host_reset(uint32_t boot, uint64_t used, uint32_t now)
{
    clock_ms = now;
    boot_number = boot;
    kept = used;
    pulsing = false;
    drive_start(&drive);
    tapper_start(&tapper, boot, used, now);
}
/* Another board with another carriage, `place` steps out. */
void host_start(uint32_t boot, uint64_t used, uint32_t now, double place, uint32_t seed)
{
    interlock = true;
    enabling = wire_open = button = stop_wins = false;
    written = 0;
    output[0] = 0;
    carriage_start(&carriage, place, seed);
    host_reset(boot, used, now);
}
void host_receive(const uint8_t *data, uint32_t length, uint32_t now)
{
    host_run(now);
    for (uint32_t i = 0; i < length; i++) {
        if (data[i] == '!')
            tapper_stop(&tapper, false);
        else
            tapper_byte(&tapper, data[i], now);
    }
}
void host_measured(uint32_t speed) { tapper_measured(&tapper, speed); }
void host_interlock(int closed) { interlock = closed; }
void host_enabling(int held) { enabling = held; }
void host_wire(int open) { wire_open = open; carriage.powered = !open; }
void host_button(int pressed) { button = pressed; }
void host_stop_wins(int wins) { stop_wins = wins; }
struct carriage *host_carriage(void) { return &carriage; }
double host_place(void) { return carriage.place; }
double host_released_from(void) { return released_from; }
void host_lose_steps(uint32_t count) { carriage.lose = count; }
void host_motor(int powered) { carriage.powered = powered; }
void host_front_switch(int stuck) { carriage.stuck = stuck; }
void host_no_bounce(void) { carriage.bounce_us = 0; }
void host_back_drive(double speed) { carriage.back_drive = speed; }
int host_state(void) { return tapper.state; }
uint32_t host_releases(void) { return releases; }
uint64_t host_kept(void) { return kept; }
const char *host_output(void)
{
    written = 0;
    return output;
}
void host_forget_output(void)
{
    written = 0;
    output[0] = 0;
}

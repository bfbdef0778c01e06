/* Emulated board for tests on the host: the functions that tapper.h requires, the spring's
 * carriage, and functions that set the inputs. The tests set its time; each millisecond it acts as
 * the real board. */
#include <math.h>
#include <string.h>

#include "carriage.h"
#include "strikers.h"
#include "tapper.h"

#define PULSE_MS 20u
#define STEPS_PER_ROOT_MJ 400.0 /* 500 N/m, 5 um per step */

static struct tapper tapper;
static struct drive drive;
static struct carriage carriage;
static bool interlock, enabling, wire_open, button, stop_wins;
static uint32_t clock_ms, pulse_until, boot_number;
static uint32_t releases;
static double released_from;
static bool pulsing;
/* Number of coils at fixed mounts; 0 for a spring. */
static uint8_t coils, charged_channel;
static struct strikers strikers;
static uint32_t flight_ms = 300;
static uint32_t leaves_at[8], returns_at[8];
static uint8_t blocked, stuck_closed, pulled;
static uint64_t kept;
static char output[1 << 14];
static size_t written;

bool board_interlock_closed(void) { return interlock; }
bool board_enabled(void) { return enabling; }
static long steps_for(uint32_t energy_uj)
{
    return lround(STEPS_PER_ROOT_MJ * sqrt(energy_uj * 1e-3));
}
uint8_t board_channels(void) { return coils ? coils : 1; }
uint8_t board_at_mounts(void) { return coils ? strikers.home & strikers.fitted : 0; }
static uint8_t switches(void)
{
    uint8_t closed = 0;
    for (uint8_t i = 0; i < coils; i++) {
        bool out = (int32_t)(clock_ms - leaves_at[i]) >= 0 && (int32_t)(returns_at[i] - clock_ms) > 0;
        closed |= (uint8_t)((out ? 0u : 1u) << i);
    }
    return (uint8_t)((closed & ~pulled) | stuck_closed);
}
bool board_can_store(uint32_t energy_uj)
{
    if (coils)
        return energy_uj >= 20;
    long steps = steps_for(energy_uj);
    double stored = 1e3 * (steps / STEPS_PER_ROOT_MJ) * (steps / STEPS_PER_ROOT_MJ);
    return steps > 0 && steps <= LONGEST_DRAW_STEPS && fabs(stored - energy_uj) <= 0.03 * energy_uj;
}
void board_home(void)
{
    if (coils)
        strikers_prove(&strikers);
    else
        drive_home(&drive);
}
void board_charge(uint32_t energy_uj, uint8_t channel)
{
    charged_channel = channel;
    if (!coils)
        drive_out(&drive, (int16_t)steps_for(energy_uj));
}
void board_discharge(void)
{
    pulsing = false;
    if (!coils)
        drive_back(&drive);
}
void board_halt(void)
{
    pulsing = false;
    if (!coils)
        drive_halt(&drive);
}
enum drive_status board_drive(void)
{
    return coils ? strikers_status(&strikers) : drive_status(&drive);
}
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
    if (coils) {
        strikers_released(&strikers, charged_channel);
        if (!(blocked & (1u << charged_channel))) {
            leaves_at[charged_channel] = clock_ms + 2;
            returns_at[charged_channel] = clock_ms + flight_ms;
        }
    }
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
    if (coils)
        strikers_tick(&strikers, switches());
    if (pulsing && clock_ms == pulse_until)
        pulsing = false;
    if (wire_open)
        tapper_stop(&tapper, true);
    tapper_button(&tapper, button, clock_ms);
    tapper_poll(&tapper, clock_ms);
}

/* Run the board until `now`. */
void host_run(uint32_t now)
{
    while (clock_ms != now)
        millisecond();
}
void host_step(void) { millisecond(); }
/* Switch the board on, with the carriage at its present position. */
void host_reset(uint32_t boot, uint64_t used, uint32_t now)
{
    clock_ms = now;
    boot_number = boot;
    kept = used;
    pulsing = false;
    drive_start(&drive);
    if (coils)
        strikers_start(&strikers, coils);
    tapper_start(&tapper, boot, used, now);
}
/* Set the number of coils from the next start on; 0 for one spring. */
void host_coils(int count) { coils = (uint8_t)count; }
/* Set the time from a release to the striker's return, and masks of the strikers that do not move
 * when released, of those pulled off their mounts, and of the switches that are stuck closed. */
void host_strikers(int flight, int do_not_move, int are_pulled, int switches_stuck)
{
    flight_ms = (uint32_t)flight;
    blocked = (uint8_t)do_not_move;
    pulled = (uint8_t)are_pulled;
    stuck_closed = (uint8_t)switches_stuck;
}
int host_channel(void) { return charged_channel; }
/* Start another board with another carriage, `place` steps from the front switch. */
void host_start(uint32_t boot, uint64_t used, uint32_t now, double place, uint32_t seed)
{
    interlock = true;
    enabling = wire_open = button = stop_wins = false;
    written = 0;
    output[0] = 0;
    carriage_start(&carriage, place, seed);
    memset(leaves_at, 0, sizeof leaves_at);
    memset(returns_at, 0, sizeof returns_at);
    for (uint8_t i = 0; i < 8; i++)
        leaves_at[i] = returns_at[i] = now;
    host_strikers(300, 0, 0, 0);
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

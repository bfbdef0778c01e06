/* A board in memory for tests on the host: the functions that tapper.h asks for, and handles to turn. */
#include <string.h>

#include "tapper.h"

static struct tapper tapper;
static bool interlock, releasing, drawn, stop_wins, can_store = true;
static uint32_t releases, draws, relaxes;
static uint64_t kept;
static char output[1 << 14];
static size_t written;

bool board_interlock_closed(void) { return interlock; }
bool board_can_store(uint32_t energy_uj) { (void)energy_uj; return can_store; }
void board_draw(uint32_t energy_uj) { (void)energy_uj; draws++; drawn = false; }
bool board_drawn(void) { return drawn; }
void board_relax(void) { relaxes++; drawn = false; releasing = false; }
bool board_release(void)
{
    if (stop_wins)
        return false;
    releases++;
    releasing = true;
    return true;
}
bool board_releasing(void) { return releasing; }
void board_keep_used(uint64_t shot) { kept = shot; }
void board_send(const char *text)
{
    size_t length = strlen(text);
    if (written + length < sizeof output) {
        memcpy(output + written, text, length + 1);
        written += length;
    }
}

void host_start(uint32_t boot, uint64_t used, uint32_t now)
{
    interlock = true;
    releasing = drawn = stop_wins = false;
    written = 0;
    output[0] = 0;
    tapper_start(&tapper, boot, used, now);
}
void host_receive(const uint8_t *data, uint32_t length, uint32_t now)
{
    for (uint32_t i = 0; i < length; i++) {
        if (data[i] == '!')
            tapper_stop(&tapper);
        else
            tapper_byte(&tapper, data[i], now);
    }
}
void host_poll(uint32_t now) { tapper_poll(&tapper, now); }
void host_press_clear(uint32_t now) { tapper_press_clear(&tapper, now); }
void host_measured(uint32_t speed) { tapper_measured(&tapper, speed); }
void host_set_interlock(int closed, uint32_t now) { interlock = closed; tapper_poll(&tapper, now); }
void host_set_drawn(uint32_t now) { drawn = true; tapper_poll(&tapper, now); }
void host_end_release(uint32_t now) { releasing = false; tapper_poll(&tapper, now); }
void host_stop_wins(int wins) { stop_wins = wins; }
int host_state(void) { return tapper.state; }
uint32_t host_releases(void) { return releases; }
uint32_t host_draws(void) { return draws; }
uint64_t host_kept(void) { return kept; }
const char *host_output(void)
{
    written = 0;
    return output;
}
void host_forget_output(void) { output[0] = 0; }

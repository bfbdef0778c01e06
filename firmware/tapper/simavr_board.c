/* The firmware's AVR binary behind a pseudo-terminal, with a model of the mechanism (libsimavr).
 *
 *     simavr_board tapper.elf [place [seed]]
 *
 * The carriage is initially `place` steps from the front switch. Prints "PORT <path>", then at
 * every edge of the release output "RELEASE <0|1> <microseconds> <place>", and in answer to "time"
 * "TIME <microseconds> <place>". Reads on its standard input
 *
 *     interlock 0|1      1: closed          motor 0|1        0: the motor's supply is cut
 *     stop 0|1           1: pressed, which  lose <steps>     number of next steps that are lost
 *                        also cuts the      switch -1|0|1    front: stuck open, works, stuck closed
 *                        motor's supply     push <steps/s>   speed of the spring's push, motor off
 *     clear 0|1          1: pressed         reset, time
 *     enabling 0|1       1: held
 *
 * Runs in real time if the computer is fast enough.
 */
#define _GNU_SOURCE
#include <fcntl.h>
#include <poll.h>
#include <stdio.h>
#include <stdlib.h>
#include <string.h>
#include <termios.h>
#include <time.h>
#include <unistd.h>

#include <simavr/avr_ioport.h>
#include <simavr/avr_uart.h>
#include <simavr/sim_avr.h>
#include <simavr/sim_elf.h>

#include "carriage.h"

#define BYTE_CYCLES 1389 /* ten bits at 115200 baud and 16 MHz */

static avr_t *avr;
static int master;
static struct carriage carriage;
static int direction, front = -1;

/* Drive an input externally, against its pull-up, also whenever the firmware sets the pull-up. */
static void set_pin(char port, int pin, int high)
{
    static uint8_t masks[2], values[2];
    int which = port == 'D';
    masks[which] |= (uint8_t)(1 << pin);
    values[which] = (uint8_t)((values[which] & ~(1 << pin)) | (high << pin));
    avr_ioport_external_t external = {
        .name = (unsigned char)port, .mask = masks[which], .value = values[which]};
    avr_ioctl(avr, AVR_IOCTL_IOPORT_SET_EXTERNAL(port), &external);
    avr_irq_t *irq = avr_io_getirq(avr, AVR_IOCTL_IOPORT_GETIRQ(port), pin);
    avr_raise_irq(irq, (uint32_t)!high); /* an unchanged level would be ignored */
    avr_raise_irq(irq, (uint32_t)high);
}

static void on_uart(struct avr_irq_t *irq, uint32_t value, void *param)
{
    (void)irq;
    (void)param;
    uint8_t byte = (uint8_t)value;
    if (write(master, &byte, 1) < 0)
        return; /* no reader: the byte is lost, as on a real line */
}

static void on_release(struct avr_irq_t *irq, uint32_t value, void *param)
{
    (void)irq;
    (void)param;
    printf("RELEASE %u %llu %g\n", value, (unsigned long long)(avr->cycle / 16), carriage.place);
    fflush(stdout);
}

static void on_direction(struct avr_irq_t *irq, uint32_t value, void *param)
{
    (void)irq;
    (void)param;
    direction = (int)value;
}

static void on_disable(struct avr_irq_t *irq, uint32_t value, void *param)
{
    (void)irq;
    (void)param;
    carriage.enabled = !value;
}

static void on_step(struct avr_irq_t *irq, uint32_t value, void *param)
{
    (void)irq;
    (void)param;
    if (value)
        carriage_step(&carriage, direction);
}

/* Advance the mechanism by 50 us. */
static void move(void)
{
    carriage_wait(&carriage, 50);
    int closed = carriage_at_front(&carriage);
    if (closed != front)
        set_pin('B', 1, !closed);
    front = closed;
}

static void inputs(void)
{
    set_pin('D', 2, 0);
    set_pin('D', 3, 0);
    set_pin('B', 0, 1);
    set_pin('B', 1, !carriage_at_front(&carriage));
    set_pin('B', 2, 1);
}

static void obey(const char *line)
{
    int value;
    if (sscanf(line, "interlock %d", &value) == 1)
        set_pin('D', 2, !value);
    else if (sscanf(line, "stop %d", &value) == 1) {
        set_pin('D', 3, value);
        carriage.powered = !value;
    } else if (sscanf(line, "clear %d", &value) == 1)
        set_pin('B', 0, !value);
    else if (sscanf(line, "enabling %d", &value) == 1)
        set_pin('B', 2, !value);
    else if (sscanf(line, "motor %d", &value) == 1)
        carriage.powered = value;
    else if (sscanf(line, "lose %d", &value) == 1)
        carriage.lose = (uint32_t)value;
    else if (sscanf(line, "switch %d", &value) == 1)
        carriage.stuck = value;
    else if (sscanf(line, "push %d", &value) == 1)
        carriage.back_drive = value;
    else if (strncmp(line, "time", 4) == 0) {
        printf("TIME %llu %g\n", (unsigned long long)(avr->cycle / 16), carriage.place);
        fflush(stdout);
    } else if (strncmp(line, "reset", 5) == 0) {
        carriage.enabled = false; /* the pull-up at the motor's driver */
        avr_reset(avr);
        inputs();
    }
}

int main(int count, char **words)
{
    elf_firmware_t firmware;
    struct termios raw;
    uint32_t flags = 0;
    memset(&firmware, 0, sizeof firmware);
    setvbuf(stdin, NULL, _IONBF, 0); /* poll() does not see bytes in the buffer of stdin */
    if (count < 2 || count > 4 || elf_read_firmware(words[1], &firmware) != 0) {
        fprintf(stderr, "usage: simavr_board tapper.elf [place [seed]]\n");
        return 2;
    }
    carriage_start(&carriage, count > 2 ? atof(words[2]) : 0.0,
                   count > 3 ? (uint32_t)atol(words[3]) : 1u);
    avr = avr_make_mcu_by_name("atmega328p");
    if (!avr)
        return 1;
    avr_init(avr);
    avr_load_firmware(avr, &firmware);
    avr->frequency = 16000000;
    avr->log = LOG_ERROR;

    master = posix_openpt(O_RDWR | O_NOCTTY | O_NONBLOCK);
    if (master < 0 || grantpt(master) || unlockpt(master))
        return 1;
    int slave = open(ptsname(master), O_RDWR | O_NOCTTY);
    tcgetattr(slave, &raw);
    cfmakeraw(&raw);
    tcsetattr(slave, TCSANOW, &raw);

    avr_ioctl(avr, AVR_IOCTL_UART_GET_FLAGS('0'), &flags);
    flags &= ~(uint32_t)(AVR_UART_FLAG_STDIO | AVR_UART_FLAG_POLL_SLEEP);
    avr_ioctl(avr, AVR_IOCTL_UART_SET_FLAGS('0'), &flags);
    avr_irq_register_notify(avr_io_getirq(avr, AVR_IOCTL_UART_GETIRQ('0'), UART_IRQ_OUTPUT), on_uart,
                            NULL);
    avr_irq_register_notify(avr_io_getirq(avr, AVR_IOCTL_IOPORT_GETIRQ('D'), 4), on_release, NULL);
    avr_irq_register_notify(avr_io_getirq(avr, AVR_IOCTL_IOPORT_GETIRQ('D'), 5), on_step, NULL);
    avr_irq_register_notify(avr_io_getirq(avr, AVR_IOCTL_IOPORT_GETIRQ('D'), 6), on_direction, NULL);
    avr_irq_register_notify(avr_io_getirq(avr, AVR_IOCTL_IOPORT_GETIRQ('D'), 7), on_disable, NULL);
    inputs();
    avr_irq_t *uart = avr_io_getirq(avr, AVR_IOCTL_UART_GETIRQ('0'), UART_IRQ_INPUT);
    avr_cycle_count_t next_byte = 0, next_move = 0;
    printf("PORT %s\n", ptsname(master));
    fflush(stdout);

    struct timespec began, now;
    clock_gettime(CLOCK_MONOTONIC, &began);
    for (;;) {
        avr_cycle_count_t until = avr->cycle + 16000; /* one millisecond */
        while (avr->cycle < until) {
            int state = avr_run(avr);
            if (state == cpu_Done || state == cpu_Crashed) {
                fprintf(stderr, "the firmware ended in state %d\n", state);
                return 1;
            }
            uint8_t byte;
            while (avr->cycle >= next_move) {
                next_move += 800;
                move();
            }
            if (avr->cycle >= next_byte) {
                next_byte = avr->cycle + BYTE_CYCLES;
                if (read(master, &byte, 1) == 1)
                    avr_raise_irq(uart, byte);
            }
        }
        struct pollfd input = {.fd = 0, .events = POLLIN};
        if (poll(&input, 1, 0) > 0) {
            char line[80];
            if (!fgets(line, sizeof line, stdin))
                return 0;
            obey(line);
        }
        clock_gettime(CLOCK_MONOTONIC, &now);
        long long real = (now.tv_sec - began.tv_sec) * 1000000ll +
                         (now.tv_nsec - began.tv_nsec) / 1000;
        long long ahead = (long long)(avr->cycle / 16) - real;
        if (ahead > 500)
            usleep((useconds_t)ahead);
    }
}
